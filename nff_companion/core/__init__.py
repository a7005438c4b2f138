"""Residual, sparse effectiveness, decisions. Pure: numpy in, numpy out, state passed and returned."""
