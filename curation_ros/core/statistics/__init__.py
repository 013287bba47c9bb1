"""Statistics of scores and of policies: detection, intervals, contrasts."""
