"""What runs with cameras share: their folder, their facts, their sparse map."""
