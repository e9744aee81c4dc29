"""Initialization of a component.

A component is initialized by the first of three methods that succeeds.

1. Images are registered with known poses, or with poses of an earlier reconstruction
   (``seed_poses``).
2. All well-connected images are registered by rotation averaging, and linear least squares for
   depth scales and positions, from relative poses with baselines measured by depth
   (``global_initialization``).
3. An image pair is registered by a relative pose that is estimated from depth-lifted points, and
   accepted if the depth maps agree (``initial_pair``, paper section 3.1).
"""
