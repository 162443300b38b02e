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
        one = f"double 0x{struct.pack('>d', value).hex().upper()}"
        return f"<{', '.join([one] * self.width)}>"
