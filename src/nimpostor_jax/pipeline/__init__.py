"""The main job, from posed images to a trained impostor and its figures: what scripts and notebooks call."""
