"""What can be proved of a feedback on a graph and on a domain."""

from echelon.certificates.certificate import Certificate, RegionCertificate
from echelon.certificates.domain import Domain
from echelon.core.words import Kind, Theorem

__all__ = ["Certificate", "Domain", "Kind", "RegionCertificate", "Theorem"]
