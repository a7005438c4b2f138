"""Laws, ablations and peers for comparison: injected into the companion by trials alone."""
