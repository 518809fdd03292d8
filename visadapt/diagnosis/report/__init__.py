"""What a diagnosis says, as text for the terminal and as an HTML page with figures; written from the result."""
