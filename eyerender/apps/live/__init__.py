"""A live page on 127.0.0.1: the rig in three dimensions, and its image, which follows the user's changes.

The extra `live` installs the libraries that it needs. The modules `guard`, `setup`, `source`, `drawing` and `painter`
work without them.
"""
