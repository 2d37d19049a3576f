"""A removal's steps: stages put together over all views (view_state.ViewState); pipeline.py runs them in order."""
