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
   A frame with several images takes the pose with which most matches are explained.
8. ``registration_history`` records failed registration attempts, so that they are not repeated.
9. ``threshold_schedule`` relaxes the acceptance thresholds if no image can be registered.

The images of one frame of a rig are registered together by the matches of all of them. An image
without a rig is the only image of its frame. For frames of rigs, ``reverse_correspondences``
exchanges the roles of the new and a registered frame, so that the more accurate depth is used.

``tentative_registration`` adds images without verification after the reconstruction is complete.
"""
