"""A study with people: films of generated behaviour in one web page, and tables of what its raters answered."""
