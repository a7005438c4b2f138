"""One file an endpoint kind; none knows the others."""
