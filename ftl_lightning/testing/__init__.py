"""Small data sets to try the package with, which nothing in it was tuned on."""
