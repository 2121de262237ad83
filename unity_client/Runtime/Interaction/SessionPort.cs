// The session as input needs it: the port of a session on threads of its own, and that over SessionClient.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;

namespace IrisSession.Interaction
{
    /// <summary>A session that is polled. Nothing here waits or throws.</summary>
    public interface ISessionPort
    {
        bool IsJoined { get; }

        /// <summary>Of the newest session that we were let into, empty before the first.</summary>
        string SessionId { get; }

        string ParticipantId { get; }

        long SceneEpoch { get; }

        bool IsStopped { get; }

        /// <summary>Time to answer a question of consent, 0 where the session does not state it.</summary>
        long ConsentTimeoutNs { get; }

        EpisodeChanged Episode { get; }

        IReadOnlyDictionary<string, ParticipantInfo> Participants { get; }

        IReadOnlyDictionary<string, Lease> Leases { get; }

        IReadOnlyDictionary<string, RobotInfo> Robots { get; }

        IReadOnlyDictionary<string, AnchorInfo> Anchors { get; }

        AlignmentState AlignmentState { get; }

        /// <summary>Return `T_world_tracking`; false without an alignment in the present tracking frame.</summary>
        bool TryGetAlignment(out RigidTransform T_world_tracking);

        /// <summary>True when session time is known.</summary>
        bool HasClock { get; }

        long ToSessionNs(long localNs);

        bool TrySendSample(SampleInput input);

        bool TryObserve(SheetSighting sighting);

        void ReportTouch(TouchReport touch);

        /// <summary>Report poses of a controller whose tip stayed in a hole. The answer is a `TipCalibrated`.</summary>
        void ReportTipPoses(string device, RigidTransform[] T_tracking_grip, long captureNs);

        /// <summary>Send a request. Returns its ticket, 0 when it could not be sent.</summary>
        long Request(ClientMessage message);

        /// <summary>Stop all robots. False: nothing takes it any more.</summary>
        bool EStop(string reason);

        /// <summary>The wearer recentred: what was aligned is void. Before anything of the new frame is sent.</summary>
        void ReportRecentred();
    }

    /// <summary>A session over sockets.</summary>
    public sealed class SessionClientPort : ISessionPort
    {
        private readonly SessionClient client;

        public SessionClientPort(SessionClient client)
        {
            this.client = client;
        }

        public bool IsJoined { get { return client.View.IsJoined; } }

        public string SessionId { get { return client.View.Welcome == null ? "" : client.View.Welcome.SessionId; } }

        public string ParticipantId { get { return client.View.ParticipantId; } }

        public long SceneEpoch { get { return client.View.SceneEpoch; } }

        public bool IsStopped { get { return client.View.IsStopped; } }

        public long ConsentTimeoutNs { get { return client.View.ConsentTimeoutNs; } }

        public EpisodeChanged Episode { get { return client.View.Episode; } }

        public IReadOnlyDictionary<string, ParticipantInfo> Participants { get { return client.View.Participants; } }

        public IReadOnlyDictionary<string, Lease> Leases { get { return client.View.Leases; } }

        public IReadOnlyDictionary<string, RobotInfo> Robots { get { return client.View.Robots; } }

        public IReadOnlyDictionary<string, AnchorInfo> Anchors { get { return client.View.Anchors; } }

        public AlignmentState AlignmentState { get { return client.View.AlignmentState; } }

        public bool HasClock { get { return client.HasClock; } }

        public bool TryGetAlignment(out RigidTransform T_world_tracking)
        {
            SessionView view = client.View;
            bool isAligned = view.Alignment != null && view.AlignmentState != AlignmentState.None;
            T_world_tracking = isAligned ? SceneDecoder.ToTransform(view.Alignment.T_world_tracking) : RigidTransform.Identity;
            return isAligned;
        }

        public long ToSessionNs(long localNs)
        {
            return client.ToSessionNs(localNs);
        }

        public bool TrySendSample(SampleInput input)
        {
            return client.TrySendSample(input);
        }

        public bool TryObserve(SheetSighting sighting)
        {
            return client.TryObserve(sighting);
        }

        public void ReportTouch(TouchReport touch)
        {
            client.Post(loop => loop.Alignment.ReportTouch(touch));
        }

        public void ReportTipPoses(string device, RigidTransform[] T_tracking_grip, long captureNs)
        {
            client.Post(loop => loop.Alignment.ReportTipPoses(device, T_tracking_grip, captureNs));
        }

        public long Request(ClientMessage message)
        {
            return client.Request(message);
        }

        public bool EStop(string reason)
        {
            return client.EStop(reason);
        }

        public void ReportRecentred()
        {
            client.Post(loop => loop.Headset.OnRecentred());
        }
    }
}
