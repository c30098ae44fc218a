"""What leaves the program: videos, pictures, and particle files that other programs open."""
