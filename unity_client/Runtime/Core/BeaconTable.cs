// Sessions that announce themselves: beacons and introductions, as bytes. docs/protocol.md, section "Discovery".
//
// Any machine can send both, so nothing in them is trusted: what a person sees is bounded and printable, and a stranger cannot
// direct us to a port of our own machine. Sockets are not here.
using System.Collections.Generic;
using System.Globalization;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>A session whose beacon was received.</summary>
    public sealed class FoundSession
    {
        /// <summary>The first beacon. Its text is printable, its host and control port can be an address.</summary>
        public Beacon Beacon { get; internal set; }

        /// <summary>`HOST:PORT` of the control channel, on each network from which its beacon came: four at most.</summary>
        public readonly List<string> Addresses = new List<string>();

        /// <summary>When the newest beacon came, by the caller's clock [ns].</summary>
        public long HeardNs { get; internal set; }
    }

    /// <summary>Collects beacons. For one thread.</summary>
    public sealed class BeaconTable
    {
        public const int Port = 7720;

        /// <summary>Largest datagram. Receive into a buffer of one byte more, so that a longer one is refused and not cut.</summary>
        public const int MaxBeaconBytes = 1_400;

        /// <summary>Largest introduction, with its length before it.</summary>
        public const int MaxIntroductionBytes = IntroductionPrefix + 4_000;
        private const int IntroductionPrefix = 4;

        /// <summary>TCP port of the introduction, from that of the control channel.</summary>
        public const int IntroductionFromControl = -1;
        private const int MaxSessions = 128;
        private const string OtherVersionText = "the session speaks another version of the protocol";
        private const int MaxAddresses = 4;

        private readonly Dictionary<string, FoundSession> found = new Dictionary<string, FoundSession>();
        private readonly WireReader reader = new WireReader();

        /// <summary>Datagrams that are no beacons.</summary>
        public long Malformed { get; private set; }

        /// <summary>Beacons of another version of the protocol.</summary>
        public long OtherVersion { get; private set; }

        /// <summary>Beacons of other machines that name a loopback host.</summary>
        public long ForeignLoopback { get; private set; }

        /// <summary>Beacons of sessions beyond the 128 that are kept.</summary>
        public long TooMany { get; private set; }

        /// <summary>Take a datagram, whatever it holds.</summary>
        /// <returns>The session, null when it was ignored and counted.</returns>
        public FoundSession Process(byte[] data, int offset, int count, string sender, long nowNs)
        {
            Beacon beacon;
            try
            {
                if (count > MaxBeaconBytes) throw new DecodeException("a beacon of " + count + " bytes");
                reader.Reset(data, offset, count);
                beacon = Beacon.Read(reader);
                reader.ExpectEnd();
            }
            catch (System.Exception error) when (error is WireException || error is DecodeException)
            {
                if (count <= MaxBeaconBytes && IsOtherVersion(data, offset, count, false)) OtherVersion++;
                else Malformed++;
                return null;
            }
            if (beacon.Protocol == Wire.Version && IsPlausible(beacon)) return Add(beacon, sender, nowNs);
            if (beacon.Protocol != Wire.Version) OtherVersion++;
            else Malformed++;
            return null;
        }

        /// <summary>Remove sessions that were last heard before `sinceNs`.</summary>
        public void RemoveSilent(long sinceNs)
        {
            List<string> silent = new List<string>();
            foreach (KeyValuePair<string, FoundSession> one in found) if (one.Value.HeardNs < sinceNs) silent.Add(one.Key);
            foreach (string id in silent) found.Remove(id);
        }

        /// <summary>Return the sessions by name, those of a name by id.</summary>
        public List<FoundSession> ListSessions()
        {
            List<FoundSession> sessions = new List<FoundSession>(found.Values);
            sessions.Sort((a, b) =>
            {
                int order = string.CompareOrdinal(a.Beacon.SessionName, b.Beacon.SessionName);
                return order != 0 ? order : string.CompareOrdinal(a.Beacon.SessionId, b.Beacon.SessionId);
            });
            return sessions;
        }

        /// <summary>Decode what a session writes to a connection at its introduction's port.</summary>
        /// <param name="data">What has come so far.</param>
        /// <param name="count">Bytes of it.</param>
        /// <param name="controlPort">The control port that was looked up.</param>
        /// <returns>The introduction, null while more bytes are to come.</returns>
        /// <exception cref="DecodeException">It is none, or of another session or version.</exception>
        public static Introduction DecodeIntroduction(byte[] data, int count, int controlPort)
        {
            if (count < IntroductionPrefix) return null;
            long length = ((long)data[0] << 24) | ((long)data[1] << 16) | ((long)data[2] << 8) | data[3];
            if (length > MaxIntroductionBytes - IntroductionPrefix) throw new DecodeException("an introduction of " + length + " bytes");
            if (count - IntroductionPrefix < length) return null;
            if (count - IntroductionPrefix > length) throw new DecodeException("bytes after an introduction");
            Introduction introduction;
            try
            {
                WireReader reader = new WireReader();
                reader.Reset(data, IntroductionPrefix, (int)length);
                introduction = Introduction.Read(reader);
                reader.ExpectEnd();
            }
            catch (WireException error)
            {
                throw new DecodeException(IsOtherVersion(data, IntroductionPrefix, (int)length, true) ? OtherVersionText : "not an introduction", error);
            }
            if (introduction.Beacon.Protocol != Wire.Version) throw new DecodeException(OtherVersionText);
            if (!IsPlausible(introduction.Beacon)) throw new DecodeException("not the introduction of a session");
            if (introduction.Beacon.Control != controlPort) throw new DecodeException("the introduction is that of another session, with control port " + introduction.Beacon.Control);
            return introduction;
        }

        /// <summary>Return whether the texts of a beacon are printable and its address can be one.</summary>
        public static bool IsPlausible(Beacon beacon)
        {
            return IsPrintable(beacon.SessionId) && IsPrintable(beacon.SessionName) && IsPrintable(beacon.Kind) && IsPrintable(beacon.KeyFingerprint)
                && beacon.SessionId.Length > 0 && beacon.SessionName.Length > 0
                && HostName.IsHost(beacon.Host) && beacon.Control > 0 && beacon.Control < 65536;
        }

        private FoundSession Add(Beacon beacon, string sender, long nowNs)
        {
            if (HostName.IsLoopback(beacon.Host) && !HostName.IsLoopback(sender))
            {
                ForeignLoopback++;
                return null;
            }
            if (!found.TryGetValue(beacon.SessionId, out FoundSession session))
            {
                if (found.Count >= MaxSessions)
                {
                    TooMany++;
                    return null;
                }
                found[beacon.SessionId] = session = new FoundSession { Beacon = beacon };
            }
            string address = HostName.Format(beacon.Host, (int)beacon.Control);
            if (!session.Addresses.Contains(address) && session.Addresses.Count < MaxAddresses) session.Addresses.Add(address);
            session.HeardNs = nowNs;
            return session;
        }

        /// <summary>Return whether what does not fit states another version, of which the rest may be.</summary>
        private static bool IsOtherVersion(byte[] data, int offset, int count, bool isIntroduction)
        {
            WireReader reader = new WireReader();
            reader.Reset(data, offset, count);
            try
            {
                long version = ReadVersion(reader, isIntroduction);
                reader.ExpectEnd();
                return version != Wire.Version;
            }
            catch (WireException)
            {
                return false;
            }
        }

        private static long ReadVersion(WireReader reader, bool isIntroduction)
        {
            long version = Wire.Version;
            for (int left = reader.ReadMapHeader(); left > 0; left--)
            {
                string key = reader.ReadString();
                if (isIntroduction && key == "beacon") version = ReadVersion(reader, false);
                else if (!isIntroduction && key == "protocol") version = reader.ReadLong();
                else reader.Skip();
            }
            return version;
        }

        /// <summary>Return whether a text is on one line and shows all of itself. What is not assigned yet passes: tables of runtimes differ.</summary>
        private static bool IsPrintable(string text)
        {
            for (int i = 0; i < text.Length; i++)
            {
                if (text[i] == ' ') continue;
                switch (CharUnicodeInfo.GetUnicodeCategory(text, i))
                {
                    case UnicodeCategory.Control:
                    case UnicodeCategory.Format:
                    case UnicodeCategory.Surrogate:
                    case UnicodeCategory.PrivateUse:
                    case UnicodeCategory.SpaceSeparator:
                    case UnicodeCategory.LineSeparator:
                    case UnicodeCategory.ParagraphSeparator:
                        return false;
                }
                if (char.IsHighSurrogate(text[i])) i++;
            }
            return true;
        }
    }
}
