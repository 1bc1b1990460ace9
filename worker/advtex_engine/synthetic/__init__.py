"""Scans of drawn objects, whose truth is known."""
