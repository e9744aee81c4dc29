"""Dense geometry of a reconstruction: stereo depth with variance, fusion, mesh."""
