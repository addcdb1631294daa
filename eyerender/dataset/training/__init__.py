"""Pictures and labels for training, in NumPy: parts of an image, their motion with the picture, and augmentation."""
