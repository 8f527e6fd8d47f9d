"""``python -m ftl_lightning``."""

import sys

from ftl_lightning.cli import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
