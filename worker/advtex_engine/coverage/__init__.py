"""What photographs show of the surface, and what is guessed for the rest."""

from advtex_engine.coverage.complete import GUESSED, SEEN, UNSEEN, Completed, complete_texture

__all__ = ["GUESSED", "SEEN", "UNSEEN", "Completed", "complete_texture"]
