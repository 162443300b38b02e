"""Vectors of numbers in LLVM text, as wide as the processor's registers."""

import dataclasses
import struct


@dataclasses.dataclass(frozen=True)
class Registers:
    """Registers of so many numbers: 2, 4 or 8."""

    width: int

    @property
    def reals(self) -> str:
        """The type of numbers."""
        return f"<{self.width} x double>"

    @property
    def wholes(self) -> str:
        """The type of whole numbers, or of the bits of numbers."""
        return f"<{self.width} x i64>"

    @property
    def truths(self) -> str:
        """The type of truth values."""
        return f"<{self.width} x i1>"

    def real(self, value: float) -> str:
        """A number in every lane."""
        return self._filled(f"double 0x{struct.pack('>d', value).hex().upper()}")

    def whole(self, value: int) -> str:
        """A whole number in every lane."""
        return self._filled(f"i64 {value}")

    def _filled(self, one: str) -> str:
        return f"<{', '.join([one] * self.width)}>"
