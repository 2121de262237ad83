// The files of an AssetCache, in a folder of the app.
using System;
using System.Collections.Generic;
using System.IO;
using IrisSession.Core;

namespace IrisSession.Storage
{
    /// <summary>
    /// Files of one folder. A file is written under another name first and then renamed, so that a kill leaves all of it or nothing under
    /// its own name.
    /// </summary>
    public sealed class DiskAssetFiles : IAssetFiles
    {
        private const string Unfinished = ".part";
        private readonly string folder;
        private long number;

        /// <param name="folder">Made where it is missing. In Unity: a folder of `Application.persistentDataPath`.</param>
        public DiskAssetFiles(string folder)
        {
            this.folder = folder;
        }

        /// <summary>Why the system refused the last time, for a log; empty when it has not.</summary>
        public string Problem { get; private set; } = "";

        public IReadOnlyList<AssetFile> List()
        {
            List<AssetFile> found = new List<AssetFile>();
            Try(() =>
            {
                Directory.CreateDirectory(folder);
                foreach (FileInfo file in new DirectoryInfo(folder).GetFiles())
                {
                    if (file.Name.EndsWith(Unfinished, StringComparison.Ordinal)) file.Delete();
                    else found.Add(new AssetFile(file.Name, file.Length, file.LastWriteTimeUtc.Ticks));
                }
            });
            return found;
        }

        public byte[] Read(string name, long maxBytes)
        {
            byte[] bytes = null;
            Try(() =>
            {
                FileInfo file = new FileInfo(Path.Combine(folder, name));
                if (file.Exists && file.Length <= maxBytes) bytes = File.ReadAllBytes(file.FullName);
            });
            return bytes;
        }

        public bool Write(string name, byte[] bytes, int offset, int count)
        {
            string target = Path.Combine(folder, name);
            string temporary = target + "." + (++number) + Unfinished;
            bool isWritten = Try(() =>
            {
                Directory.CreateDirectory(folder);
                using (FileStream file = new FileStream(temporary, FileMode.Create, FileAccess.Write, FileShare.None))
                {
                    file.Write(bytes, offset, count);
                    file.Flush(true); // a battery may end before the system writes it by itself
                }
                if (File.Exists(target)) File.Delete(target);
                File.Move(temporary, target);
            });
            if (isWritten) return true;
            string problem = Problem;
            Try(() => File.Delete(temporary)); // else it takes room until the next start
            Problem = problem;
            return false;
        }

        public void Touch(string name)
        {
            Try(() => File.SetLastWriteTimeUtc(Path.Combine(folder, name), DateTime.UtcNow));
        }

        public bool Delete(string name)
        {
            return Try(() => File.Delete(Path.Combine(folder, name)));
        }

        private bool Try(Action action)
        {
            try
            {
                action();
                return true;
            }
            catch (Exception error) when (error is IOException || error is UnauthorizedAccessException || error is NotSupportedException || error is System.Security.SecurityException)
            {
                Problem = error.Message;
                return false;
            }
        }
    }
}
