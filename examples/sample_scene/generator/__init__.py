"""Sample-scene generator: geometry, materials, the room, rendering, priors."""
