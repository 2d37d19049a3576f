"""Mathematics that knows nothing of splats."""
