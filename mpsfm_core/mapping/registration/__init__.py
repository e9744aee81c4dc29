"""Registration of images by absolute pose estimation."""
