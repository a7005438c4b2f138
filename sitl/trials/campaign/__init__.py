"""Campaigns: as many flights as it takes to state a rate, drawn from a file, flown anywhere, kept in Parquet."""
