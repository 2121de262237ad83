// Everything of a session that is drawn, below one transform: the frame in which the headset tracks.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;
using UnityEngine;

namespace IrisSession.Unity
{
    /// <summary>Draws a session. All calls are of the engine's thread; none throws what a session sent.</summary>
    public sealed class WorldView : IDisposable
    {
        public readonly MediaStreams Media = new MediaStreams();
        public readonly BodyPoses Poses;
        public readonly AvatarTable Avatars;
        public readonly SceneView Scene;

        /// <summary>Of the left and of the right hand.</summary>
        public readonly GhostView[] Ghosts;
        private readonly Transform world;
        private readonly MaterialCache materials;
        private readonly AvatarViews avatarViews;
        private readonly LightingView lighting = new LightingView();
        private readonly List<CloudView> clouds = new List<CloudView>();
        private readonly DrawBudget budget;
        private readonly long delayNs;

        /// <param name="parent">The frame in which the headset tracks: of an XR origin, its camera offset.</param>
        /// <param name="templates">Materials of the package.</param>
        /// <param name="assets">Called on another thread.</param>
        /// <param name="draws">Of the headset: the scene's plan is made within its `Scene`.</param>
        /// <param name="delayNs">Time by which what is shown is behind session time [ns].</param>
        public WorldView(Transform parent, IrisMaterials templates, ISceneAssets assets, DrawBudget draws, long delayNs = 33_000_000)
        {
            budget = draws;
            this.delayNs = delayNs;
            Poses = new BodyPoses(delayNs);
            Avatars = new AvatarTable(delayNs, draws.Avatars);
            materials = new MaterialCache(templates);
            world = new GameObject("iris-session world").transform;
            world.SetParent(parent, false);
            Scene = new SceneView(world, materials, assets, Media);
            Ghosts = new[] { new GhostView(Scene, materials), new GhostView(Scene, materials) };
            avatarViews = new AvatarViews(Avatars, materials, world);
        }

        /// <summary>The frame of the session's world.</summary>
        public Transform World { get { return world; } }

        /// <summary>True while the world is drawn grey: its state is too old to act on.</summary>
        public bool IsDimmed { get; private set; }

        /// <summary>Points of clouds that are drawn.</summary>
        public int PointsDrawn { get; private set; }

        /// <summary>Clouds beyond those that this headset draws.</summary>
        public int CloudsLeftOut { get; private set; }

        /// <summary>Put the world where the alignment says that it is.</summary>
        public void SetAlignment(RigidTransform T_world_tracking) { UnityValues.Place(world, T_world_tracking.Inverse); }

        /// <summary>Draw one frame.</summary>
        /// <param name="nowNs">Session time [ns].</param>
        /// <param name="nowS">Real time of the engine [s].</param>
        /// <param name="participants">Who is in the session.</param>
        public void Draw(long nowNs, double nowS, IReadOnlyDictionary<string, ParticipantInfo> participants)
        {
            if (Poses.TryShow(nowNs)) Scene.Bodies.Show(Poses);
            Scene.Draw(nowS, nowNs - delayNs);
            if (Scene.Lighting != null) lighting.Show(Scene.Lighting, Scene.Plan, Scene.Bodies);
            avatarViews.Show(nowNs, participants);
            DrawClouds();
            IsDimmed = Poses.Buffer.IsStale(nowNs);
            LightingView.SetDimmed(IsDimmed);
        }

        public void Dispose()
        {
            foreach (CloudView one in clouds) one.Dispose();
            clouds.Clear();
            foreach (GhostView one in Ghosts) one.Destroy();
            avatarViews.Destroy();
            Scene.Dispose();
            UnityEngine.Object.Destroy(world.gameObject);
        }

        private void DrawClouds()
        {
            IReadOnlyList<CloudStream> streams = Media.Clouds;
            for (int i = clouds.Count - 1; i >= 0; i--)
            {
                bool isKnown = false;
                for (int k = 0; k < streams.Count; k++) isKnown |= streams[k].Name == clouds[i].Name;
                if (isKnown) continue;
                clouds[i].Dispose();
                clouds.RemoveAt(i);
            }
            int count = Math.Min(streams.Count, budget.Clouds);
            long wanted = 0;
            for (int k = 0; k < count; k++) wanted += streams[k].Cloud.Count;
            double share = budget.Scene.Points > 0 && wanted > budget.Scene.Points ? (double)budget.Scene.Points / wanted : 1.0;
            PointsDrawn = 0;
            CloudsLeftOut = streams.Count - count;
            for (int k = 0; k < count; k++)
            {
                CloudView view = null;
                for (int i = 0; i < clouds.Count; i++) if (clouds[i].Name == streams[k].Name) view = clouds[i];
                if (view == null) clouds.Add(view = new CloudView(streams[k].Name, materials.Points));
                view.Update(streams[k], (int)(share * streams[k].Cloud.Count));
                view.Draw(world);
                PointsDrawn += view.Drawn;
            }
        }
    }
}
