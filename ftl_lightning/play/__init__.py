"""``play``: a page on one's own machine on which a person shows behaviour, sees it learned, and mixes it."""
