// One part of a scene: a renderer on its body, or one call for all its places.
using IrisSession.Core;
using UnityEngine;
using UnityEngine.Rendering;

namespace IrisSession.Unity
{
    /// <summary>Draws one part. Without a mesh it draws nothing.</summary>
    public sealed class ScenePartView
    {
        /// <summary>Half the side of the box in which instances may be [m]: they are all drawn or none.</summary>
        private const float ReachM = 1000f;
        private readonly SceneBodies bodies;
        private readonly GameObject single;
        private readonly MeshFilter filter;
        private readonly Transform[] carriers;
        private readonly Matrix4x4[] local;
        private readonly Matrix4x4[] world;

        public ScenePartView(ScenePart part, SceneBodies bodies, Material material, string name)
        {
            this.bodies = bodies;
            Material = material;
            if (part.Places.Length == 1)
            {
                single = new GameObject(name);
                single.transform.SetParent(bodies.Find(part.Places[0].Body), false);
                UnityValues.Place(single.transform, part.Places[0].T_body_part);
                filter = single.AddComponent<MeshFilter>();
                MeshRenderer renderer = single.AddComponent<MeshRenderer>();
                renderer.sharedMaterial = material;
                renderer.shadowCastingMode = ShadowCastingMode.Off;
                renderer.receiveShadows = false;
                return;
            }
            carriers = new Transform[part.Places.Length];
            local = new Matrix4x4[carriers.Length];
            world = new Matrix4x4[carriers.Length];
            for (int i = 0; i < carriers.Length; i++)
            {
                carriers[i] = bodies.Find(part.Places[i].Body);
                local[i] = UnityValues.ToMatrix(part.Places[i].T_body_part);
            }
        }

        public Material Material { get; }

        /// <summary>What is drawn, null while it is not here.</summary>
        public Mesh Mesh { get; private set; }

        /// <summary>True when the finest mesh is drawn.</summary>
        public bool IsFine { get; private set; }

        /// <summary>Show another mesh; the one before is destroyed.</summary>
        public void Show(Mesh mesh, bool isFine)
        {
            if (!(Mesh is null)) Object.Destroy(Mesh);
            Mesh = mesh;
            IsFine = isFine;
            if (filter != null) filter.sharedMesh = mesh;
        }

        /// <summary>Draw the places of a part that has several. Once a frame; allocates nothing.</summary>
        public void Draw()
        {
            if (carriers == null || Mesh is null) return;
            for (int i = 0; i < carriers.Length; i++) world[i] = carriers[i].localToWorldMatrix * local[i];
            RenderParams how = new RenderParams(Material);
            how.worldBounds = new Bounds(bodies.Root.position, new Vector3(ReachM, ReachM, ReachM));
            Graphics.RenderMeshInstanced(how, Mesh, 0, world, carriers.Length, 0);
        }

        /// <summary>Remove it. Its material belongs to those who made it.</summary>
        public void Destroy()
        {
            Show(null, false);
            if (single != null) Object.Destroy(single);
        }
    }
}
