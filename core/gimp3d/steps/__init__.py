"""A removal's steps: stages put together over all views (run.ViewState); pipeline.py runs them in order."""
