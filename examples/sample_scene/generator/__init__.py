"""Parts of the sample-scene generator: geometry, materials, the room, rendering, priors."""
