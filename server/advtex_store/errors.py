"""Errors of the store.

StoreError
├── RecordNotFound        no such object, or it belongs to somebody else
├── IllegalTransition     the job's state does not allow it
├── StaleAttempt          the attempt is no longer the job's current one: stop, write nothing more
├── Superseded            a newer request has the upload now, or it was deleted
├── IdempotencyMismatch   the same key came with another body
├── IdempotencyInFlight   the same key is being worked on right now
├── QuotaExceeded         the owner has as much as the key allows
├── ReferenceRefused      a scan's URL is malformed, or lies where nothing may be read
│   └── ReferenceUnreadable   it lies where it may, and this service's user or keys have no right to read it
├── BlobNotFound
├── ScanDamaged           the storage holds other bytes than were uploaded
├── ResultsUnreadable     what lists a job's results is there, and damaged
├── BlobsUnavailable      the storage cannot be reached now
│   └── BlobsRefused          it answers and refuses: there is no such bucket, or the keys do not open it
├── NoSpace               the disk is full; nothing was kept
└── SchemaRefused         the database was made by a release that this one cannot work with
"""

from __future__ import annotations


class StoreError(Exception):
    """Base of all errors that the store raises on purpose."""


class RecordNotFound(StoreError):
    """No such object for this owner."""


class IllegalTransition(StoreError):
    """The job's state does not allow what was asked."""


class StaleAttempt(StoreError):
    """The attempt lost its job to a later one, or the job has ended: stop, and write nothing more."""


class Superseded(StoreError):
    """A newer request goes on with the upload."""


class NotUnderstood(StoreError):
    """The job's options say what this release does not know, or name a method that is not installed here."""


class IdempotencyMismatch(StoreError):
    """The idempotency key was used before with another body."""


class IdempotencyInFlight(StoreError):
    """A request with this idempotency key has not been answered yet."""


class QuotaExceeded(StoreError):
    """The owner has as many jobs or bytes as the key allows."""


class ReferenceRefused(StoreError):
    """A scan's URL is malformed, or lies where nothing may be read."""


class ReferenceUnreadable(ReferenceRefused):
    """The service has no right to read the scan."""


class BlobNotFound(StoreError):
    """No blob has this key."""


class ScanDamaged(StoreError):
    """A scan's stored bytes are not those that were uploaded."""


class ResultsUnreadable(StoreError):
    """What stands where a job's manifest should is none."""


class NoSpace(StoreError):
    """The disk is full; the partial file was removed."""


class BlobsUnavailable(StoreError):
    """The blob storage cannot be reached at the moment."""


class BlobsRefused(BlobsUnavailable):
    """The storage answers, and refuses: no retry helps before somebody mends its settings."""


class SchemaRefused(StoreError):
    """The database has a schema that this release does not know."""
