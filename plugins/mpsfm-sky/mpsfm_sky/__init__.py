"""Sky masks from a segmentation network, or from color rules."""
