"""The pictures of the pages and of the command."""
