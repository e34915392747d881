"""What values show of themselves in a notebook, and the look that all figures share."""
