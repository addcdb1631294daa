"""The pupil: candidates, edge points, an ellipse by consensus, the maximum-likelihood fit and its confidence."""
