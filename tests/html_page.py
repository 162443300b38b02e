"""A page as a browser would read it."""

import json
import re
from html.parser import HTMLParser

_ADDRESSES = ("src", "href", "srcset", "data", "action", "poster")


class Page(HTMLParser):
    """What a browser would make of a page: its tags, its scripts and its visible text."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.tags, self.scripts, self.words, self._inside = [], [], [], []
        self.captions = {}
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.tags.append((tag, attributes))
        if "data-figure" in attributes:
            self.captions[attributes["data-figure"]] = self.words[-1]
        if tag in ("script", "style"):
            self._inside.append(tag)
            self.scripts.append((attributes.get("id"), ""))

    def handle_endtag(self, tag):
        if self._inside and tag == self._inside[-1]:
            self._inside.pop()

    def handle_data(self, data):
        if self._inside:
            name, text = self.scripts[-1]
            self.scripts[-1] = (name, text + data)
        else:
            self.words.append(data)

    @property
    def addresses(self):
        """Everything that a browser would load or follow, except data in the page."""
        found = [given.get(name) or "data:" for _, given in self.tags for name in _ADDRESSES]
        return [address for address in found if not address.startswith("data:")]

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())

    @property
    def figures(self):
        """Plotly figures by section, view and place, such as "error-0-7"."""
        return json.loads(self.script("figures"))["figures"]

    def script(self, identifier):
        return next(text for key, text in self.scripts if key == identifier)

    @property
    def names(self):
        return [tag for tag, _ in self.tags]

    def titles(self, view):
        """The captions of a view's panels, such as "force-0"."""
        return [self.captions[key] for key in self.captions if re.fullmatch(rf"{view}-\d+", key)]
