"""Folders of images, point clouds and other recorders' files."""
