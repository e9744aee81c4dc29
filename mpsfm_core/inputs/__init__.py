"""From a folder of photos to undistorted views with known cameras."""
