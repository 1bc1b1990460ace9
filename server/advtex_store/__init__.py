"""What server and worker both remember: rows (the truth), blobs (the bytes) and the queue (transport only)."""
