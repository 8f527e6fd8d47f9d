"""``python -m ftl_lightning``."""

import sys

if __name__ == "__main__":
    # Before anything else is imported: with -m Python looks for every module in the current folder first, so that a file there that
    # is named as a module of a library would run in its place. The folder that this package comes from stays.
    if not sys.flags.safe_path and sys.path[0] != __file__.rpartition("/ftl_lightning/")[0]:
        del sys.path[0]
    from ftl_lightning.cli.main import main

    sys.exit(main(sys.argv[1:]))
