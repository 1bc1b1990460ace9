"""What a run needs of memory, and what it gives up where there is too little."""

from advtex_engine.budget.limits import Budget

__all__ = ["Budget"]
