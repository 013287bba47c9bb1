"""Statistics of scores and of policies."""
