"""Contacts and impacts: declarations, laws, forces, impulses, and the contact states after a jump."""
