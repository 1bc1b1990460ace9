"""One module per texturing method, behind one signature."""
