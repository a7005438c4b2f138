"""Neural-Fly's basis: what it is fed with, how it is trained, and its forward pass in flight."""
