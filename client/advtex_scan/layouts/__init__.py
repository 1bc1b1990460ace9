"""One module per accepted layout; each turns files into a ScanManifest."""
