"""``play``: a local page on which a person demonstrates behaviour, sees it learned, and mixes it."""
