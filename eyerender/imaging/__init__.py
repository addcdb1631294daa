"""From frames to images and back: rendering, the image observer, labels, and comparison of the observers."""
