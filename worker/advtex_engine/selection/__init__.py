"""One photograph per face: candidates, labels, leveled seams, detail projected back."""
