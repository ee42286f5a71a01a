"""Tables, a module for each idea: cells from results, then rows of text, Markdown and CSV."""
