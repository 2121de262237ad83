"""Resume tokens: bound to a key, used up by retiring, bounded, survive in the next front without being readable."""

from __future__ import annotations

from iris_session.security.resume_tokens import ResumeTokens


def test_token_is_valid_for_its_participant_and_key_until_retired() -> None:
    tokens = ResumeTokens(4)
    token = tokens.issue("key", "p1")
    assert tokens.find_participant(token, "key") == "p1"
    assert tokens.find_participant(token, "other key") is None
    assert tokens.find_participant(b"guess", "key") is None
    tokens.use_up(token)
    assert tokens.find_participant(token, "key") is None


def test_full_table_removes_the_oldest_token() -> None:
    tokens = ResumeTokens(2)
    issued = [tokens.issue("key", f"p{i}") for i in range(3)]
    assert [tokens.find_participant(token, "key") for token in issued] == [None, "p1", "p2"]


def test_next_front_continues_with_tokens_and_numbers() -> None:
    tokens = ResumeTokens(4)
    assert [tokens.allocate_connection(), tokens.allocate_connection()] == [1, 2]
    token = tokens.issue("key", "p1")
    blob = tokens.encode()
    assert token not in blob
    successor = ResumeTokens(4, blob)
    assert successor.find_participant(token, "key") == "p1"
    assert successor.allocate_connection() == 3


def test_revoked_gateway_key_removes_tokens_of_its_participants() -> None:
    tokens = ResumeTokens(8)
    tokens.issue("gateway", "p1")
    tab = tokens.issue("key of a tab", "p2", behind="gateway")
    other = tokens.issue("key of a tab", "p3", behind="another gateway")
    successor = ResumeTokens(8, tokens.encode())
    assert successor.revoke_key("gateway") == ["p1", "p2"]
    assert successor.find_participant(tab, "key of a tab") is None
    assert successor.find_participant(other, "key of a tab") == "p3"


def test_changed_is_true_after_a_change() -> None:
    tokens = ResumeTokens(4)
    assert not tokens.changed
    token = tokens.issue("key", "p1")
    assert tokens.changed
    tokens.encode()
    tokens.use_up(b"unknown")
    assert not tokens.changed
    tokens.use_up(token)
    assert tokens.changed


def test_participant_keeps_the_used_and_the_newest_token() -> None:
    tokens = ResumeTokens(4)
    ann, first = tokens.issue("ann", "p1"), tokens.issue("bob", "p2")
    second = tokens.issue("bob", "p2", first)
    third = tokens.issue("bob", "p2", first)  # the welcome with the second was lost
    assert [tokens.find_participant(token, "bob") for token in (first, second, third)] == ["p2", None, "p2"]
    assert tokens.find_participant(ann, "ann") == "p1"
