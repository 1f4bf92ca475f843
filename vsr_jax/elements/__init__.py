"""What acts on an arm: loads, supports, contacts, and what drives its threads, on the nodes of a
grid."""
