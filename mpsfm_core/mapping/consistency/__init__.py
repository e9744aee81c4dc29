"""Detection of wrong poses and wrong pairs (paper section 3.4).

* ``depth_consistency`` compares the depth maps of two posed images. The violation ratio is the
  share of pixels that have a surface where the other image sees empty space.
* ``pair_consistency`` applies this check to verified pairs before images are registered, and
  reweights the matches of a pair by the support of the poses that depth allows.
* ``misregistration`` detects registered images whose matches mostly contradict their pose (minimum
  cut of the match graph).
* ``depth_agreement`` measures the share of depth that agrees with the depth of other images.
"""
