"""Stock PX4, told by parameters what its motors can still give."""
