"""The words that client, server and worker share. Pydantic only.

Versions meet: while a fleet is upgraded, and wherever clients are older or newer than their server. What a caller sends
(`JobSpec`, `JobOptions`, `WebhookSpec`) is refused with a name that is not known: it would not do what was meant. What
is told or stored is read without the names that are not known, and with defaults for those that are missing.
"""
