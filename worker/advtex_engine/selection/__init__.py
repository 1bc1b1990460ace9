"""One photograph per face: candidates, labels, leveled seams, tones of many, detail projected back."""
