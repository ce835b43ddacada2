"""The intermediate representation (IR): statements, operations, and the builder that emits them."""
