"""The texture while it is made and the finished model from all around, with torch alone; and the curves of a run."""
