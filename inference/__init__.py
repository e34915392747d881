"""The inference backends, one file each."""
