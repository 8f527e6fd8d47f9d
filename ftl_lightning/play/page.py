"""The page as one answer."""


def page(nonce: str, offline: str = "") -> str:
    return "<html><body>stub</body></html>"
