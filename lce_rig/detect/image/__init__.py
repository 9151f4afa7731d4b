"""The board in images: corners to a fraction of a pixel, both poses, image quality."""
