"""Registration of further images into a component (paper section 3.2).

One call of ``register_next_image`` in ``mapping/incremental_registration.py`` runs the following
steps.

1. ``image_selection`` ranks the unregistered images by summed match scores with registered images.
2. ``scene/local_bundle`` selects the local bundle of the best matching image as reference images.
3. ``correspondences`` collects 2D-3D correspondences from triangulated and depth-lifted points.
4. ``pose_hypotheses`` generates pose hypotheses by PnP, essential matrices and network proposals.
5. ``pose_support`` scores each hypothesis by all correspondences and refines the best hypotheses.
6. ``pose_estimation`` refines a few distinct poses by bundle adjustment.
7. ``IncrementalRegistration`` registers the image, triangulates, refines locally and checks depth
   consistency (paper section 3.4). If the depth is inconsistent, the registration is rolled back.
8. ``registration_history`` records failed registration attempts, so that they are not repeated.
9. ``threshold_schedule`` relaxes the acceptance thresholds if no image can be registered.

``tentative_registration`` adds images without verification after the reconstruction is complete.
"""
