"""Certificates: the guarantees of a feedback on a graph and on a domain."""

from echelon.core.words import Kind, Theorem
from echelon.synthesis.certificates.certificate import Certificate, RegionCertificate
from echelon.synthesis.certificates.domain import Domain

__all__ = ["Certificate", "Domain", "Kind", "RegionCertificate", "Theorem"]
