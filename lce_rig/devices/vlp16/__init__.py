"""The VLP-16: packets from the network, its web page, its status."""
