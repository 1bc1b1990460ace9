"""How close a texture comes to photographs that it has not seen."""
