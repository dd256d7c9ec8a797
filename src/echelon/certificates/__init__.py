"""What can be proved of a feedback on a graph and on a domain."""

from echelon.certificates.certificate import Certificate, Kind, RegionCertificate
from echelon.certificates.domain import Domain

__all__ = ["Certificate", "Domain", "Kind", "RegionCertificate"]
