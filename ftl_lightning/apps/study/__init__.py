"""A study with people: films of generated behaviour on a web page, and tables of the raters' answers."""
