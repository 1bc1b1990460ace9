"""What server and worker both remember: job rows, blobs and the queue."""
