// Two keys with self-signed certificates, of the kind that gateways make (EC P-256), valid until 2119. For tests alone.
using System;
using System.Security.Cryptography.X509Certificates;
using IrisSession.Core.Tests;

namespace IrisSession.Transport.Tests
{
    /// <summary>A certificate with its key.</summary>
    internal sealed class TestCertificate
    {
        public static readonly TestCertificate First = new TestCertificate(
            "MIIDgAIBAzCCA0YGCSqGSIb3DQEHAaCCAzcEggMzMIIDLzCCAg8GCSqGSIb3DQEHBqCCAgAwggH8AgEAMIIB9QYJKoZIhvcNAQcBMBwGCiqGSIb3DQEMAQMwDgQI52zgJCo5/joCAggAgIIByFa6Bx"
            + "At4S/XE2ptGHrlkvO1jLkPfZZcyURMxz6Qqd5YyGxQfARJspRCvsjHDGc2XfSpoSbML1QfTK9W5uA0auPAkFghXieWCfRPUSb6e+33YSdtDUV4GTRvOc5KW5FNgdfu3qU7tnneY2VWWAbAr79qPio4"
            + "J26nFT3cckdoYdBFeIG8zlyuPX5ZzAFSOXA6voBJzD0n8Hda9VyAC6N7/nzku4DyfMF/A4e83+a7NEcM/9LuHZilwEgYAzQvBHZGQVf5g5N2kd00+0s1xzEvjG0NF43Gpnb5oDaiYYBuGGQRs7mL2k"
            + "LWQPpcFkwC8AE+JCp+64ZncPG/stplhXjZmLdYUgNJrqkVr/hhtR/TPolx2weSBmU+9U4YnLwUILKu2oIS2fQnXoZpSGQtrzxI/m3jBSr5K4/AOj0XA8Cpj9dsPW65ldizSElO98hqudh9jIU7MEpd"
            + "U8wFGG46erNrLjvpV980tdm6sqoei/1XTsAd71Sc3Q9mxS1NmB212opF4HXWLxo9wPg13CIWsfDQ+EQ38So/CzTfSakz2QuvFv/yqGXACPYU/QMxkv6akvpGA80yQP4tg4oxAam9/uSApaw/Qgdte5"
            + "Au0zCCARgGCSqGSIb3DQEHAaCCAQkEggEFMIIBATCB/gYLKoZIhvcNAQwKAQKggbQwgbEwHAYKKoZIhvcNAQwBAzAOBAjzLHnh3eZXXwICCAAEgZAgexOlqJR8OOPhkJNZW/PNZTqsidY8gaUDsNGF"
            + "i6LPfbO5AqkOmCHEs6qKdfnSxrxVDWZJ5lvDmQuiCWE6ElbGH61bHCcxgtBv/N10uQDRJyfR2FrG/z3UJTxZzmn63cgWcCgPt3w86CZeiqNR4L4sPkPns8CmNGrTPhbABIrKEeAoetsp71LtWBFYiV"
            + "UN/g8xODARBgkqhkiG9w0BCRQxBB4CAHQwIwYJKoZIhvcNAQkVMRYEFNUNbotytgWh/JELHR+u2vOuGXWZMDEwITAJBgUrDgMCGgUABBQR0rtkVx8fx5O3SQ9dvr1XM9Do+wQI4t1agv0ENPUCAggA",
            "a74edcc5f1ec7303be1a121b297c9bd3e91a97b5cb6787c0c79a7c1acda05121");

        public static readonly TestCertificate Second = new TestCertificate(
            "MIIDgAIBAzCCA0YGCSqGSIb3DQEHAaCCAzcEggMzMIIDLzCCAg8GCSqGSIb3DQEHBqCCAgAwggH8AgEAMIIB9QYJKoZIhvcNAQcBMBwGCiqGSIb3DQEMAQMwDgQIrgvgI6JlDJUCAggAgIIByLhUAK"
            + "3jPN6uXJZJUuL2Ok2oB+7rLjRjncaF3in+nqTrpo2ylrnsfy3UZ+9KWlUOo6Wb224S6vLObO2Q6GirqVxwAExyldqGiVSsSbsbUhq8Q9WGvjmg/vp//s1TxoyCNHgV63DQt3Fs60mk8LDIt0JZkqe+"
            + "agceSrX37pVCfHp5C7gtirvw5Eqn9tOVf2vtgf00zwmmM5QIE9jPwR89kIwvtvS20kG3WJ6VGLSzvTav28VhiRARKa64J4L7r5VcODwqaqmh42Plaq9Boj4dlfTpaMXOnX9gmxYeKBNQY3Gn6TELxg"
            + "YPOuBPa1PHT/vYsfmvUKZ7E+h3Jj8lCmrsRDukV42WB6+YriuhJOj8YnFUvKIgLt8BGbmK6TLUXuyf22TgAI8swzwtTU0QTk1W7ehBZnz/4Gn6YXd3SNGxmhs6X0Awxoh7gm9CQsjk8t65V4rQDq4V"
            + "0ku26LK4iGdu2/T7whA9NhpQGK5ZmvMua7zGpyylzeXRDqMDLO9LC+ZMs33zCnQQnMjRD7bmAP8ztK2AdeWPcUaJ5jrGVCMNF1feiVhnotw5IGNSrQQi9w7fU59zcKVd26nkgq4N5klqdGLMzM5wg1"
            + "zWiDCCARgGCSqGSIb3DQEHAaCCAQkEggEFMIIBATCB/gYLKoZIhvcNAQwKAQKggbQwgbEwHAYKKoZIhvcNAQwBAzAOBAgm2bIUDVC7JwICCAAEgZBgKQbS/JgzP2XMpClh0vOk7qOBxKdStcODYSWS"
            + "Y7weEEaZzGGcWYy9ePSN/wI0jFk0/dtFGk8RULxLuErLRhuFbg0yE9qEbIWCP+0LlFjJ/VfQNnEK5XqfUAKUOTV6ukUKbqaUoQ9uGoKVmXlKuFeTK26aUNoZStWXC+ncMh+pRFobKWRb+nRN6TbRiK"
            + "iFYscxODARBgkqhkiG9w0BCRQxBB4CAHQwIwYJKoZIhvcNAQkVMRYEFMa9uvcvpx+94Xp74Q5TMdzXc0M2MDEwITAJBgUrDgMCGgUABBSr0asSuwvHczwh2q/uxCBmOt4L/QQIoov13czBH4ECAggA",
            "02c73cbeb5b9354cd739a56de8e9bbafd770758f9b68cddab1689e08e07a7c73");

        private const string Password = "test";
        private readonly byte[] pkcs12;

        /// <summary>SHA-256 of the public key, as Python computes it.</summary>
        public readonly byte[] Hash;

        private TestCertificate(string pkcs12, string hash)
        {
            this.pkcs12 = Convert.FromBase64String(pkcs12);
            Hash = Golden.FromHex(hash);
        }

        public X509Certificate2 Load()
        {
            return new X509Certificate2(pkcs12, Password);
        }
    }
}
