"""From frames to images and back: capture, the image observer, labels, and comparison of the observers."""
