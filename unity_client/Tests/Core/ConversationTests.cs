// docs/protocol/conversations.json: the core behaves as the file states.
using System;
using System.Collections.Generic;
using System.Security.Cryptography;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class ConversationTests
    {
        private static IEnumerable<string> Names()
        {
            foreach (Json conversation in Golden.Load("conversations")["conversations"].Items)
            {
                yield return conversation["name"].Text;
            }
        }

        [TestCaseSource(nameof(Names))]
        public void Plays(string name)
        {
            Json conversation = Golden.Load("conversations")["conversations"].Items.Find(one => one["name"].Text == name);
            bool isLoader = conversation["core"].Text == "asset loader";
            ConversationPlayer player = isLoader ? null : new ConversationPlayer(conversation["secret"].Text, conversation["resume_token"].Text);
            AssetPlayer loader = new AssetPlayer();
            int number = 0;
            foreach (Json step in conversation["steps"].Items)
            {
                string where = name + ", step " + number++ + ": " + step["do"].Text;
                if (isLoader) loader.PlayStep(step, where);
                else player.PlayStep(step, where);
            }
        }
    }

    /// <summary>A client core that takes steps of a conversation.</summary>
    internal sealed class ConversationPlayer
    {
        private readonly MemoryIdentity identity;
        private readonly ClientConnection connection;
        private readonly SampleBuilder samples;
        private bool hasState;
        private long stateEpoch;
        private string sessionId = "";

        public ConversationPlayer(string secret, string resumeToken)
        {
            identity = new MemoryIdentity(Golden.FromHex(secret), Golden.FromHex(resumeToken));
            connection = new ClientConnection(
                new Hello { Role = "operator", Name = "ann", Software = "conversation", Devices = new[] { "right" }, Capabilities = new[] { "run:0011223344556677" } },
                identity);
            samples = new SampleBuilder(connection);
        }

        public void PlayStep(Json step, string where)
        {
            long nowNs = step["at_ns"].Long;
            Reply reply = null;
            switch (step["do"].Text)
            {
                case "open":
                    connection.Open(nowNs);
                    break;
                case "close":
                    connection.Close();
                    break;
                case "tick":
                    connection.Tick(nowNs);
                    break;
                case "disconnect":
                    connection.HandleDisconnect(nowNs);
                    break;
                case "receive":
                    connection.Receive(MakeMessage(step["frames"].Items), nowNs);
                    if (connection.Welcome != null && connection.Welcome.SessionId != sessionId)
                    {
                        sessionId = connection.Welcome.SessionId;
                        hasState = false;
                    }
                    break;
                case "receive_state":
                    List<Multipart> messages = new List<Multipart>();
                    foreach (Json frames in step["messages"].Items) messages.Add(MakeMessage(frames.Items));
                    if (!connection.Stream.Drain(messages, connection.Clock.SessionNs(nowNs), nowNs)) break;
                    hasState = true;
                    stateEpoch = connection.Stream.Header.SceneEpoch;
                    break;
                case "request":
                    connection.Request(MakeRequest(step["message"].Text, step["fields"]));
                    break;
                case "reply":
                    reply = connection.Requests.PopReply(step["request_id"].Long);
                    break;
                case "estop":
                    connection.Send(new EStop { Reason = step["reason"].Text });
                    break;
                case "sample":
                    connection.Send(samples.MakeSample(MakeInput(step)));
                    break;
                default:
                    throw new ArgumentException(step["do"].Text + " is not a step of a conversation");
            }
            JsonCheck.AreEqual(step["sent"], TakeSent(), where + ": sent");
            JsonCheck.AreEqual(step["inbox"], TakeInbox(), where + ": inbox");
            if (step.Find("replies") != null) JsonCheck.AreEqual(step["replies"], new List<object> { reply == null ? null : JsonCheck.FromWire(reply) }, where + ": replies");
            JsonCheck.AreEqual(step["state"], Describe(nowNs), where + ": state");
        }

        internal static Multipart MakeMessage(List<Json> frames)
        {
            string all = "";
            foreach (Json frame in frames) all += frame.Text;
            Multipart message = new Multipart { Buffer = Golden.FromHex(all) };
            int at = 0;
            foreach (Json frame in frames)
            {
                message.Add(at, frame.Text.Length / 2);
                at += frame.Text.Length / 2;
            }
            return message;
        }

        private static ClientMessage MakeRequest(string type, Json fields)
        {
            switch (type)
            {
                case "acquire":
                    Acquire acquire = new Acquire();
                    foreach (KeyValuePair<string, Json> field in fields.Fields)
                    {
                        if (field.Key == "robots") acquire.Robots = field.Value.Items.ConvertAll(item => item.Text).ToArray();
                        else throw new ArgumentException(field.Key);
                    }
                    return acquire;
                case "clear_estop":
                    return new ClearEStop { StopSeq = fields["stop_seq"].Long };
                default:
                    throw new ArgumentException(type);
            }
        }

        private static SampleInput MakeInput(Json step)
        {
            double[] p = step["p"].Doubles();
            double[] q = step["q"].Doubles();
            SampleInput input = new SampleInput
            {
                Device = step["device"].Text,
                Pose = new RigidTransform(new Double3(p[0], p[1], p[2]), new DoubleQuaternion(q[0], q[1], q[2], q[3])),
                Clutch = (bool)step["clutch"].Value,
                CaptureNs = step["capture_ns"].Long,
            };
            foreach (Json robot in step["robots"].Items) input.Robots.Add(robot.Text);
            return input;
        }

        private List<object> TakeSent()
        {
            List<object> sent = new List<object>();
            for (Outgoing item = connection.PeekOutgoing(); item != null; item = connection.PeekOutgoing())
            {
                sent.Add(Golden.ToHex(item.Bytes, 0, item.Count));
                connection.PopOutgoing(true);
            }
            return sent;
        }

        private List<object> TakeInbox()
        {
            List<object> inbox = new List<object>();
            while (connection.Inbox.TryTake(out InboxMessage message))
            {
                if (message.IsMissed) inbox.Add(new Dictionary<string, object> { ["type"] = "missed", ["first"] = message.First, ["last"] = message.Last });
                else inbox.Add(JsonCheck.FromWire(message.Message));
            }
            return inbox;
        }

        private Dictionary<string, object> Describe(long nowNs)
        {
            SessionMirror mirror = connection.Mirror;
            bool waits = connection.IsJoined || connection.Phase == ConnectionPhase.Joining || connection.Phase == ConnectionPhase.Waiting;
            Dictionary<string, object> leases = new Dictionary<string, object>();
            foreach (string name in mirror.Leases.Keys) leases[name] = connection.FindLeaseVersion(name) < 0 ? null : (object)connection.FindLeaseVersion(name);
            Dictionary<string, object> poses = new Dictionary<string, object>();
            double[] shown = hasState && stateEpoch >= mirror.BodiesSince ? connection.Stream.Poses : null;
            foreach (KeyValuePair<string, int> body in mirror.BodyIndex)
            {
                if (shown == null || 7 * body.Value >= shown.Length) poses[body.Key] = null;
                else
                {
                    List<object> row = new List<object>();
                    for (int k = 0; k < 7; k++) row.Add(Math.Round(shown[7 * body.Value + k], 6));
                    poses[body.Key] = row;
                }
            }
            return new Dictionary<string, object>
            {
                ["phase"] = connection.Phase.ToString().ToLowerInvariant(),
                ["generation"] = connection.Generation,
                ["participant_id"] = connection.ParticipantId,
                ["connection_epoch"] = connection.ConnectionEpoch,
                ["resume_token"] = Golden.ToHex(identity.ResumeToken, 0, identity.ResumeToken.Length),
                ["failure"] = connection.Failure == null ? "" : connection.Failure.Code,
                ["retryable_refusal"] = connection.RetryableRefusal == null ? "" : connection.RetryableRefusal.Code,
                ["next_deadline_ns"] = waits ? (object)connection.NextDeadlineNs(nowNs) : null,
                ["session_ns"] = connection.Clock.IsSynced ? (object)connection.Clock.SessionNs(nowNs) : null,
                ["rtt_ns"] = connection.Clock.RttNs,
                ["synced"] = mirror.IsSynced,
                ["event_seq"] = mirror.EventSeq,
                ["scene"] = new List<object> { mirror.SceneEpoch, mirror.SceneRevision, mirror.SceneHash },
                ["mirror_hash"] = mirror.IsSynced ? MirrorHash.Compute(mirror) : null,
                ["leases"] = leases,
                ["body_poses"] = poses,
                ["malformed"] = connection.Counters.Malformed,
                ["other_connection"] = connection.Counters.OtherConnection,
                ["reconnects"] = connection.Counters.Reconnects,
            };
        }
    }

    /// <summary>An asset loader that takes steps of a conversation, with the assets in memory.</summary>
    internal sealed class AssetPlayer
    {
        private readonly AssetLoader loader = new AssetLoader();
        private readonly Dictionary<string, List<byte>> stored = new Dictionary<string, List<byte>>();

        public void PlayStep(Json step, string where)
        {
            long nowNs = step["at_ns"].Long;
            string outcome = "";
            switch (step["do"].Text)
            {
                case "want":
                    loader.Add(step["address"].Text, step["size"].Long);
                    List<string> lookups = new List<string>();
                    loader.TakeLookups(lookups);
                    foreach (string address in lookups)
                    {
                        stored[address] = new List<byte>();
                        loader.OnMissing(address, 0);
                    }
                    break;
                case "receive":
                    byte[] head = Golden.FromHex(step["frames"].Items[0].Text);
                    outcome = ProcessChunk(AssetChunk.Read(new WireReader(head)), Golden.FromHex(step["frames"].Items[1].Text), nowNs);
                    break;
                case "link_lost":
                    loader.OnLinkLost(nowNs);
                    break;
            }
            List<ChunkRequest> requests = new List<ChunkRequest>();
            loader.TakeRequests(nowNs, requests);
            List<object> sent = new List<object>();
            foreach (ChunkRequest request in requests)
            {
                byte[] bytes = new AssetRequest { Version = 1, ConnectionEpoch = 1, RequestId = request.RequestId, Address = request.Address, Offset = request.Offset, Length = request.Length }.Encode();
                sent.Add(Golden.ToHex(bytes, 0, bytes.Length));
            }
            JsonCheck.AreEqual(step["sent"], sent, where + ": sent");
            Assert.AreEqual(step["outcome"].Text, outcome, where);
            Assert.AreEqual((bool)step["idle"].Value, loader.IsIdle, where);
        }

        private string ProcessChunk(AssetChunk chunk, byte[] data, long nowNs)
        {
            AssetOutcome outcome = loader.ProcessChunk(chunk.RequestId, chunk.Address, chunk.Offset, chunk.Total, data.Length, nowNs);
            if (outcome == AssetOutcome.Failed) return "failed: " + loader.FailureReason;
            if (outcome != AssetOutcome.Store) return outcome.ToString().ToLowerInvariant();
            stored[chunk.Address].AddRange(data);
            loader.OnStored(data.Length);
            if (!loader.IsComplete(chunk.Address)) return "stored";
            using (SHA256 sha = SHA256.Create())
            {
                byte[] digest = sha.ComputeHash(stored[chunk.Address].ToArray());
                if (Golden.ToHex(digest, 0, digest.Length) == chunk.Address)
                {
                    loader.Remove(chunk.Address);
                    return "complete";
                }
            }
            stored[chunk.Address].Clear();
            return loader.RestartAsset(chunk.Address) ? "hash mismatch, again" : "failed: hash";
        }
    }

    /// <summary>An identity that is kept in memory.</summary>
    internal sealed class MemoryIdentity : IIdentityStore
    {
        public MemoryIdentity(byte[] secret, byte[] resumeToken)
        {
            Secret = secret;
            ResumeToken = resumeToken;
        }

        public byte[] Secret { get; }

        public byte[] ResumeToken { get; private set; }

        public void Remember(byte[] token)
        {
            ResumeToken = token;
        }
    }
}
