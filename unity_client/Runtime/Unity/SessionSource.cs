// A session over sockets as the source of a world.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;

namespace IrisSession.Unity
{
    /// <summary>Brings what a client and its scene fetcher have. Start and stop those elsewhere. Frames without news allocate nothing.</summary>
    public sealed class SessionSource : IWorldSource
    {
        private readonly SessionClient client;
        private readonly SceneFetcher scene;
        private Multipart media = new Multipart();
        private DeliveryBudget seenBudget;
        private Alignment seenAlignment;
        private string sessionId = "";
        private long seenStateNs = long.MinValue;
        private long seenPresenceNs = long.MinValue;
        private int seenMissing = -1;
        private bool isReleased;

        /// <param name="client">The session.</param>
        /// <param name="scene">Its scene, planned within `IrisWorld.Draws.Scene`. Nothing else may take its updates.</param>
        public SessionSource(SessionClient client, SceneFetcher scene)
        {
            this.client = client;
            this.scene = scene;
        }

        public long SessionNowNs { get { return client.ToSessionNs(MonotonicClock.NowNs); } }

        public IReadOnlyDictionary<string, ParticipantInfo> Participants { get { return client.View.Participants; } }

        public byte[] Find(string address) { return scene.Find(address); }

        public void Update(WorldView world)
        {
            SessionView view = client.View;
            TakeScene(world);
            TakeState(world, view);
            TakePresence(world, view);
            TakeMedia(world, view);
            if (view.Alignment == seenAlignment) return;
            seenAlignment = view.Alignment;
            bool isPlaced = seenAlignment != null && seenAlignment.Kind != AlignmentKind.None;
            world.SetAlignment(isPlaced ? SceneDecoder.ToTransform(seenAlignment.T_world_tracking) : RigidTransform.Identity);
        }

        private void TakeScene(WorldView world)
        {
            SceneUpdate update = scene.TakeUpdate();
            if (update != null)
            {
                world.Scene.Apply(update.Plan, update.Changes);
                isReleased = false;
            }
            int missing = scene.Progress.MissingCount;
            if (!isReleased && missing == seenMissing && scene.Progress.IsComplete && world.Scene.IsComplete)
            {
                isReleased = true; // all is built
                scene.ReleaseBytes();
            }
            if (missing == seenMissing) return;
            seenMissing = missing;
            world.Scene.OnAssets();
        }

        /// <summary>Take the newest state once its bodies are known, also when other code has taken it.</summary>
        private void TakeState(WorldView world, SessionView view)
        {
            client.TakeState();
            StateFrame state = client.State;
            if (state.SessionTimeNs == seenStateNs || state.BodiesVersion != view.BodiesVersion) return;
            seenStateNs = state.SessionTimeNs;
            if (view.Welcome != null && view.Welcome.SessionId != sessionId)
            {
                sessionId = view.Welcome.SessionId;
                world.Poses.Buffer.Clear(); // its clock is another one
            }
            world.Poses.Add(state.SessionTimeNs, state.SceneEpoch, state.Poses, view.Bodies);
        }

        private void TakePresence(WorldView world, SessionView view)
        {
            client.TakePresence();
            PresenceFrame presence = client.Presence;
            if (presence.SessionTimeNs == seenPresenceNs) return;
            seenPresenceNs = presence.SessionTimeNs;
            world.Avatars.Add(presence.Items, presence.Count, presence.SessionTimeNs, view.ParticipantId);
        }

        private void TakeMedia(WorldView world, SessionView view)
        {
            if (view.Budget != seenBudget && view.Budget != null)
            {
                seenBudget = view.Budget;
                world.Media.Retain(seenBudget);
                List<string> wishes = new List<string>();
                foreach (StreamBudget one in seenBudget.Streams)
                {
                    if (one.Encoding == MediaEncoding.Deformable || one.Encoding == MediaEncoding.Cloud) wishes.Add(one.Stream);
                }
                client.Post(session => session.SetMediaWishes(wishes));
            }
            for (int i = 0; i < MediaStreams.MaxStreams && client.TryTakeMedia(ref media); i++) world.Media.Process(media);
        }
    }
}
