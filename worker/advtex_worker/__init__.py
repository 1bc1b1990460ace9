"""Runs queued jobs: RQ task, GPU runner process, progress."""
