"""Work over many episodes: examine, score, audit, self-check."""
