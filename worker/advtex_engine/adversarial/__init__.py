"""The optimization against a patch discriminator: pairs, examples, losses, and their fast forms."""
