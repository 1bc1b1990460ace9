"""The defaults of `advtex-engine bench`; nothing here imports torch."""

DEVICE, WIDTH, HEIGHT, PRESET, VIEWS, FACES = "auto", 640, 480, "paper", 16, 80_000
