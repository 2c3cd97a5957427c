"""What a browser shows: pages made on the server, and the small scripts that they use."""
