"""Conformance checks: what a class of another package must do, as functions to call in a test."""
