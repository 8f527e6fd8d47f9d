"""Small data sets for trying the package, on which nothing in it was tuned."""
