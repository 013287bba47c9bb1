"""What can be seen in an episode: fingers, carries, alerts, checks, length."""
