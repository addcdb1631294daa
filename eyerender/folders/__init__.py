"""Image files, folders of labelled images, and output folders of commands."""
