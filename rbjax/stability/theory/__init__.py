"""What is known of a method by itself: its polynomials, roots, regions, orders, and one step."""
