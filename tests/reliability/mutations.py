"""Random harm to the bytes of a file."""

import random

BOUNDARIES = [0, 1, 2, *(2**bits + step for bits in (7, 8, 15, 16, 31, 32, 63, 64) for step in (-1, 0))]


def mutated(content: bytes, draw: random.Random) -> bytes:
    """Return the content after one to eight random changes; half of them near its start, where headers are."""
    harmed = bytearray(content)
    for _ in range(2 ** draw.randrange(4)):
        if not harmed:
            break
        reach = min(len(harmed), 4096) if draw.random() < 0.5 else len(harmed)
        place = draw.randrange(reach)
        kind = draw.choice(("bit", "bytes", "number", "copy", "cut", "insert", "zeros"))
        if kind == "bit":
            harmed[place] ^= 1 << draw.randrange(8)
        elif kind == "bytes":
            harmed[place : place + draw.randint(1, 16)] = draw.randbytes(draw.randint(1, 16))
        elif kind == "number":
            width = draw.choice((1, 2, 4, 8))
            value = draw.choice(BOUNDARIES) % 256**width
            harmed[place : place + width] = value.to_bytes(width, draw.choice(("little", "big")))
        elif kind == "copy":
            source, size = draw.randrange(len(harmed)), draw.randint(1, 512)
            harmed[place : place + size] = harmed[source : source + size]
        elif kind == "cut" and draw.random() < 0.2:
            del harmed[place:]
        elif kind == "insert":
            harmed[place:place] = draw.randbytes(draw.randint(1, 16))
        else:
            size = draw.randint(1, 64)
            harmed[place : place + size] = bytes(len(harmed[place : place + size]))
    return bytes(harmed)
