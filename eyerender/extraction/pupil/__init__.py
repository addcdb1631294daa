"""The pupil: candidates, edge points, ellipse by consensus, maximum-likelihood fit, and confidence."""
