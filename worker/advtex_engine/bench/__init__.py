"""Times, bytes and operations of the stages and of a step."""
