"""Files with something wrong with them, for the fuzz targets."""

from __future__ import annotations

from hypothesis import strategies as st


@st.composite
def broken(draw: st.DrawFn, whole: bytes, edits: int = 3) -> bytes:
    """``whole`` after up to ``edits`` edits: bits flipped, bytes replaced, cut, inserted or repeated, or the end lost.

    A result may equal ``whole``: an edit can undo another.
    """
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, edits))):
        at = draw(st.integers(0, max(0, len(data) - 1)))
        length = draw(st.integers(1, 16))
        match draw(st.sampled_from(["flip", "replace", "cut", "insert", "repeat", "truncate"])):
            case "flip" if data:
                data[at] ^= 1 << draw(st.integers(0, 7))
            case "replace":
                data[at : at + length] = draw(st.binary(min_size=1, max_size=16))
            case "cut":
                del data[at : at + length]
            case "insert":
                data[at:at] = draw(st.binary(min_size=1, max_size=16))
            case "repeat":
                data[at:at] = data[at : at + length]
            case "truncate":
                del data[at:]
    return bytes(data)
