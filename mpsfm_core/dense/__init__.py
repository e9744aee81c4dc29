"""Dense geometry of a reconstruction: multi-view stereo, depth map fusion and meshing."""
