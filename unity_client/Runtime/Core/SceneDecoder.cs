// Scene specifications: bytes to a description whose references all have their target. A port of iris_session/protocol/scene.py.
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Decodes and checks specifications. All that they hold is right-handed, Z up, in metres.</summary>
    public static class SceneDecoder
    {
        /// <summary>Largest specification that is read [bytes]: some 100,000 visuals.</summary>
        public const int MaxBytes = 32_000_000;

        /// <summary>Version of specifications that is read.</summary>
        public const int Version = 1;

        /// <summary>Decode a specification.</summary>
        /// <exception cref="DecodeException">The bytes are none of this version, or a reference has no target.</exception>
        public static SceneSpec Decode(byte[] data, int offset, int count)
        {
            if (count > MaxBytes) throw new DecodeException("a scene specification of " + count + " bytes, at most " + MaxBytes + " are read");
            SceneSpec spec;
            try
            {
                WireReader reader = new WireReader();
                reader.Reset(data, offset, count);
                spec = SceneSpec.Read(reader);
                reader.ExpectEnd();
            }
            catch (WireException error)
            {
                throw new DecodeException("not a scene specification", error);
            }
            if (spec.Version != Version) throw new DecodeException("the scene has version " + spec.Version + ", this app reads " + Version + ": update the older one");
            Check(spec);
            return spec;
        }

        /// <summary>Check that every reference has its target and every id is unique.</summary>
        /// <exception cref="DecodeException">It is not so.</exception>
        public static void Check(SceneSpec spec)
        {
            HashSet<long> bodies = new HashSet<long>();
            foreach (Body body in spec.Bodies)
            {
                if (body.Parent != -1 && !bodies.Contains(body.Parent)) throw new DecodeException("body " + body.Id + " has the parent " + body.Parent + ", which is not listed before it");
                AddId(bodies, body.Id, "bodies");
            }
            HashSet<long> visuals = new HashSet<long>();
            foreach (Visual visual in spec.Visuals)
            {
                AddId(visuals, visual.Id, "visuals");
                CheckShape(spec, bodies, visual.Body, visual.Geometry, visual.Material);
            }
            HashSet<long> sites = new HashSet<long>();
            foreach (Site site in spec.Sites)
            {
                AddId(sites, site.Id, "sites");
                CheckShape(spec, bodies, site.Body, site.Geometry, site.Material);
            }
            foreach (Light light in spec.Lights)
            {
                CheckWatcher(bodies, light.Body, light.Target);
                CheckReference("texture", light.Texture, spec.Textures.Length);
            }
            foreach (Camera camera in spec.Cameras) CheckWatcher(bodies, camera.Body, camera.Target);
            foreach (Deformable part in spec.Deformables) CheckReference("material", part.Material, spec.Materials.Length);
            foreach (Material material in spec.Materials)
            {
                foreach (TextureUse use in material.Textures) CheckReference("texture", use.Texture, spec.Textures.Length);
            }
            CheckReference("texture", spec.Environment.Skybox, spec.Textures.Length);
            foreach (Tendon tendon in spec.Tendons)
            {
                CheckReference("material", tendon.Material, spec.Materials.Length);
                foreach (long site in tendon.Sites) if (!sites.Contains(site)) throw new DecodeException("a tendon runs through the site " + site + ", which is not there");
            }
            foreach (Mesh mesh in spec.Meshes) if (mesh.Levels.Length == 0) throw new DecodeException("a mesh has no level");
            foreach (Texture texture in spec.Textures) if (texture.Levels.Length == 0) throw new DecodeException("a texture has no level");
        }

        /// <summary>Return a pose of a message.</summary>
        public static RigidTransform ToTransform(Pose pose)
        {
            return new RigidTransform(
                new Double3(pose.P[0], pose.P[1], pose.P[2]),
                new DoubleQuaternion(pose.Q[0], pose.Q[1], pose.Q[2], pose.Q[3]).Normalized);
        }

        private static void AddId(HashSet<long> ids, long id, string kind)
        {
            if (!ids.Add(id)) throw new DecodeException("two " + kind + " have the id " + id);
        }

        private static void CheckShape(SceneSpec spec, HashSet<long> bodies, long body, Geometry geometry, long material)
        {
            CheckBody(bodies, body);
            CheckReference("mesh", geometry.Mesh, spec.Meshes.Length);
            CheckReference("height field", geometry.Hfield, spec.Hfields.Length);
            CheckReference("material", material, spec.Materials.Length);
        }

        private static void CheckWatcher(HashSet<long> bodies, long body, long target)
        {
            CheckBody(bodies, body);
            if (target != -1) CheckBody(bodies, target);
        }

        private static void CheckBody(HashSet<long> bodies, long body)
        {
            if (!bodies.Contains(body)) throw new DecodeException("something is on body " + body + ", which is not there");
        }

        private static void CheckReference(string kind, long index, int count)
        {
            if (index >= count) throw new DecodeException("reference to " + kind + " " + index + ", but there are " + count);
        }
    }
}
