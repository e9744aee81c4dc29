"""Initialization of a component.

A component starts in one of three ways, tried in this order:

1. From known poses, or from the poses of an earlier reconstruction (``seed_poses``).
2. From the poses of all well-connected images (``global_initialization``): rotation averaging, then
   linear scales and positions from relative poses whose lengths come from depth.
3. From an image pair (``initial_pair``, paper section 3.1): its relative pose is estimated from
   depth-lifted points, refined, and rejected if the depth maps contradict each other.
"""
