"""Thin operators: they read the scene, call the core, and show the result."""
