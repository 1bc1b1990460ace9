"""The words that client, server and worker share. Pydantic only."""
