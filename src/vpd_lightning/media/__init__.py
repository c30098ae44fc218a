"""Pictures, videos, camera paths, point files: what other programs and people look at."""
