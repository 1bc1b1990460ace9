"""What a scan is: manifest, archive access, layouts and the structural check. Standard library only."""
