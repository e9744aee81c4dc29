"""Detection of wrong poses and wrong pairs (paper section 3.4).

* ``depth_consistency`` compares the depth maps of two posed images. The violation ratio is the
  share of pixels with a surface where the other image sees empty space.

* ``pair_consistency`` checks the depth of verified pairs before images are registered, and weights
  the matches of a pair by the support of its best depth-consistent pose.

* ``misregistration`` detects registered images whose matches mostly contradict their pose (minimum
  cut of the match graph).
"""
