"""Figures, a module for each idea. What has no data is not drawn: no panel, or no figure at all."""
