"""Cameras and exposures, refined so that the photographs agree on the surface."""
