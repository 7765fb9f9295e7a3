"""Tables in Markdown, statistics and plots from rows of results."""
