"""Samples become an episode: the stream, the topic map, the gate and the builder."""
