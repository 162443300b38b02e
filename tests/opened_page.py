"""Pages as a browser takes them apart."""

from html.parser import HTMLParser

_ADDRESSES = ("src", "href", "srcset", "data", "action")


class OpenedPage(HTMLParser):
    """The elements of a page: tag and attributes."""

    def __init__(self, text):
        super().__init__()
        self.elements = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    @property
    def addresses(self):
        """Everything that a browser would load or follow, except data in the page."""
        found = [given.get(name) or "data:" for _, given in self.elements for name in _ADDRESSES]
        return [address for address in found if not address.startswith("data:")]
