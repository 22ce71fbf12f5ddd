"""MCAP files: how they are written, read in any state, and finished."""
