"""What is returned: windows with their picture and glints, labels, and exported scenes."""
